"""How good a calibration is (`grade`), why it is bad (`error_attribution`), what has moved since (`drift`)."""
