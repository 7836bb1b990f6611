"""What `thruster new` writes: files that work as they stand, to be changed into one's own."""
