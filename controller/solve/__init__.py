"""Compensation images: the bounded solver, appearances, targets, metrics."""
