"""A calibrated stage in the formats of other programs: `formats` lists them, `content` is what they are made of."""
