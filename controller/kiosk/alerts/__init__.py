"""Alerts: events of the kiosk, sent by mail and to a webhook. `alerts` decides what is sent when; start there."""
