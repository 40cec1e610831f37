"""The hardware layer: `interfaces`, `values`, `errors`, `registry`, byte links, protocol codecs (`codecs`), and
tests for drivers (`conformance`).
"""
