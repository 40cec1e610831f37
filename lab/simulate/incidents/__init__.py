"""What happens to a simulated kiosk from outside: `draw` makes a `script`, whose items `happenings` lets happen."""
