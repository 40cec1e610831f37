"""The kiosk's state for an MQTT broker: `bridge`, and how the broker is named (`options`)."""
