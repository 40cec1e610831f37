"""A USB device for tests of the bus itself: it sends back what it gets."""

from __future__ import annotations

from lab.emulated.usb.device import BULK, INTERRUPT, EmulatedUsbDevice, Endpoint, SetupPacket, Stall, UsbNames


class EchoDevice(EmulatedUsbDevice):
    """Bulk 0x02 comes back on 0x81; vendor request 1 stores or returns bytes; ``say`` goes to pipe 0x83."""

    endpoints = (Endpoint(0x81, BULK, 512), Endpoint(0x02, BULK, 512), Endpoint(0x83, INTERRUPT, 64))

    def __init__(self, serial: str = "E-1") -> None:
        super().__init__(UsbNames(0x1209, 0x0001, "Tests", "Echo", serial))
        self.stored = b""

    def class_request(self, setup: SetupPacket, data: bytes) -> bytes:
        if setup.request != 1:
            raise Stall
        if setup.to_host:
            return self.stored
        self.stored = data
        return b""

    def out(self, endpoint: int, data: bytes) -> None:
        self.send(0x81, data)

    def halt(self) -> None:
        """The bulk IN pipe stalls until it is cleared."""
        with self.lock:
            self.pipes[0x81].halted = True
        self.on_ready()

    def say(self, text: str) -> None:
        self.send(0x83, text.encode())
