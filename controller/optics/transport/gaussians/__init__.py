"""The transport with one Gaussian per projector pixel. Entry: `transport.PatchTransport`."""
