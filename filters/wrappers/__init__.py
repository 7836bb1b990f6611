"""Filters around Gymnasium envs, single and in number."""
