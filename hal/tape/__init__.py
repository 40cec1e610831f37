"""Tapes: all traffic between this computer and its devices, in one file. Entry: `recorder`, `reading`."""
