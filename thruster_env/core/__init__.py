"""What all packages use: compilation, random streams, threads, checks, files, matrices and their source text."""
