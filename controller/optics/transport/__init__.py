"""The light transport T: metapixels as patches, and the products T p and T' r.

Entry: `factory.build_transport` makes the `LightTransport` of a calibration, a linear operator in SciPy's sense.
"""

from controller.optics.transport.factory import build_transport
from controller.optics.transport.operator import LightTransport

__all__ = ["LightTransport", "build_transport"]
