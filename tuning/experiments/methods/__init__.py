"""The study of methods of tuning: the same filter, box, data and budget for all, scored on held-out truth."""
