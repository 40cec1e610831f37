"""The numeric half, arrays in and arrays out: `capture`, `calibrate`, `transport`, `solve`, and `plan` beside them."""
