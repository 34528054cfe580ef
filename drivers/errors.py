"""Errors of devices, sorted by who is responsible."""


class DeviceError(Exception):
    """An error of a device: ``device`` is its name on the bench, ``message`` the text without that name."""

    def __init__(self, device: str, message: str) -> None:
        """Keep the device's name and the message apart, too."""
        super().__init__(f"{device}: {message}")
        self.device = device
        self.message = message


class LinkLost(DeviceError):
    """The link is gone, or the peer does not answer."""


class BadReply(DeviceError):
    """The peer answered, but not as its protocol says."""


class DeviceRefused(DeviceError):
    """The device understood and refused, with its own code."""


class DeviceFault(DeviceError):
    """The device reports a fault of its own."""
