"""What builds the site beside Sphinx and its extensions; docs/conf.py names it."""
