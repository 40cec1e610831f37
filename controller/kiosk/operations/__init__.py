"""All operations of a kiosk, declared once in `table.OPERATIONS`; HTTP, socket, commands and MQTT are made from it."""
