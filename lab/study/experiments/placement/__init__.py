"""Projectors put where `velatura plan` says: `experiment`, and what is measured."""
