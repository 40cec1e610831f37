"""Emulated projectors on their own LAN port: the same control boards behind TCP. Entry: `server`, `gates`."""
