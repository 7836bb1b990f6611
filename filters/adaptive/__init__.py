"""Filters that learn the noise as they go, or distrust measurements that do not fit."""
