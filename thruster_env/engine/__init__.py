"""One compiled step for one thruster and for thousands, and where its numbers lie."""
