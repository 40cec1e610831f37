"""Emulated devices that misbehave like real ones, and the optical bench behind them."""
