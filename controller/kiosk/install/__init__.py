"""`velatura kiosk install`: makes a bare Debian a kiosk, and takes that back. `system` does every change, `steps` has
the order and what is written, `restored` fits a restored stage to this computer.
"""
