"""Solves on many machines with Dask distributed (docs/how-to/cluster.md). Entry: `connect`, `appearances`."""
