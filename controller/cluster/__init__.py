"""Work spread over machines by Dask distributed (docs/facade.md)."""
