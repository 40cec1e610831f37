"""Projectors reached over a network: their own LAN port, or a device server with a serial port. Entry: `driver`."""
