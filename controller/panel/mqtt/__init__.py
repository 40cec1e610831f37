"""MQTT: `bridge` connects a kiosk to a broker, `options` are its settings, `home_assistant` describes the entities."""
