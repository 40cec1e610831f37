"""MQTT: `bridge` connects a kiosk to a broker, `options` are the broker's settings."""
