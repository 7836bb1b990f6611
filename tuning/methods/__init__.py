"""Methods of tuning: published methods that find Q, R and other numbers, each behind the same interface."""
