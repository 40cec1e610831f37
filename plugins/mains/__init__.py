"""Mains by network: outlets of a PDU (`snmp_pdu.DRIVER`), Modbus relays (`modbus_relay.DRIVER`)."""
