"""Computers of one house, linked by Zenoh with TLS: who belongs to it, how one joins, and what they tell each other.

Start at ``session``. Only what is linked imports it: a kiosk by itself and the player do not.
"""
