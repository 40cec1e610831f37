"""Light by way of other surfaces, G in T = (I + G) L. Entry: `indirect_light`, and `fit`, which finds it."""
