"""Bundles: what a kiosk plays; format, writer, reader, signing, install."""
