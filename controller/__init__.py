"""Velatura's controller. Kept empty of imports: the player must start without loading the rest."""
