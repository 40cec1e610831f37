"""From captures to the light transport's parts: decode, radiometry, geometry, metapixels."""
