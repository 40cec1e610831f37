"""Who judges a simulated kiosk: a `witness` checks its `promises` against what really is."""
