"""Oracles of a simulated kiosk: `monitor` checks its `invariants` after each step, without the kiosk's own code."""
