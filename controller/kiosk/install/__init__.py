"""`velatura kiosk install`: makes a bare Debian a kiosk, and takes that back. `system` does every change, `outputs`
turns what the X server tells into its configuration, `files` has what is written, `steps` the order.
"""
