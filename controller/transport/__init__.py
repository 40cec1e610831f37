"""The light transport T: metapixels as patches, and the products T p and T' r."""

from controller.transport.light import LightTransport

__all__ = ["LightTransport"]
