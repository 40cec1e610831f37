"""Control boards of single families, each from its maker's documents alone. One module for each maker."""
