"""What a device is: interfaces, values, errors, registry, byte links, protocol codecs, conformance suite."""
