"""Parts of any plant's env: memory of copies, channels, reports; envs of any model and of logs."""
