"""One compiled step for one thruster and for thousands, and the layout of its packed parameters."""
