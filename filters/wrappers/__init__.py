"""Filters around Gymnasium envs and vector envs."""
