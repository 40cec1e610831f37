"""Incidents of a simulated kiosk: `generator` draws a `scenario` from a seed, `injection` injects it into a life."""
