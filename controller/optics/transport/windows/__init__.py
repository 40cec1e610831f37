"""The transport by small windows of camera samples. Entry: `transport.WindowTransport`, built by `build`."""
