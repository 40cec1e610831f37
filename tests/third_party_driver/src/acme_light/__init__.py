"""Acme's light posts, which tell illuminance by TCP, for Velatura."""

from __future__ import annotations

from acme_light.sensor import DRIVER, AcmeLight

__all__ = ["DRIVER", "AcmeLight"]
