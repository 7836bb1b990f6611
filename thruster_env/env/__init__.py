"""What an env is made of, for any plant: memory of copies, channels, reports; envs of any model and of logs."""
