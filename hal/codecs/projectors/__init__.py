"""Projector protocols: PJLink, serial control tables and the profiles that describe them."""
