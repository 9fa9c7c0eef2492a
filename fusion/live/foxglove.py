"""A live view in Foxglove: what the node publishes, over its WebSocket (extra `foxglove`)."""

from typing import Any

from terrafusion.datasets.core.errors import ConfigError


class FoxgloveView:
    """A server on this machine to which the Foxglove application connects (ws://localhost:PORT).

    Raises:
        ConfigError: foxglove-sdk is not installed, or the port is taken.
    """

    def __init__(self, port: int) -> None:
        try:
            import foxglove
        except ImportError:
            raise ConfigError(
                "the Foxglove view needs the package foxglove-sdk",
                remedy="pip install 'terrafusion[foxglove]'",
            ) from None
        try:
            self._server = foxglove.start_server(name="terrafusion", port=port)
        except Exception as error:
            raise ConfigError(f"port {port} cannot be used: {error}", remedy="give another one") from None
        self._channels: dict[str, Any] = {}

    def publish(self, topic: str, msgtype: str, cdr: bytes) -> None:
        """Show a message; its definition goes along, so that nothing else is needed to read it."""
        if topic not in self._channels:
            self._channels[topic] = _channel(topic, msgtype)
        self._channels[topic].log(cdr)

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()


def _channel(topic: str, msgtype: str) -> Any:
    import foxglove
    from rosbags.typesys import Stores, get_typestore

    text, _ = get_typestore(Stores.ROS2_HUMBLE).generate_msgdef(msgtype, ros_version=2)
    schema = foxglove.Schema(name=msgtype, encoding="ros2msg", data=text.encode())
    return foxglove.Channel(topic, schema=schema, message_encoding="cdr")
