"""The hardware layer: `interfaces`, `values`, `errors`, `notices`, `registry`, byte links, protocol codecs
(`codecs`), and tests for drivers (`conformance`).
"""
