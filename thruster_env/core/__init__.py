"""What all packages use: compilation, random streams, threads, checks, files, plots."""
