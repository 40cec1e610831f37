"""PTP over TCP (PTP/IP). Entry: `link`."""
