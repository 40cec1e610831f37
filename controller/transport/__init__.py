"""The light transport T and its products."""
