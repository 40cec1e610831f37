"""What a device is: `interfaces`, `values`, `errors`, `registry`, byte links, protocol codecs (`codecs`), and
the tests for drivers (`conformance`).
"""
