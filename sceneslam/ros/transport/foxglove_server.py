"""A WebSocket server on this machine for Foxglove: ROS 2 messages, and messages of its panels."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Mapping, Sequence
from time import monotonic_ns
from typing import Any

import foxglove
from foxglove.websocket import Capability, Parameter

from sceneslam.ros.encode import Encoder
from sceneslam.ros.transport.transport import Arrival, Heard, Publication, Publisher, Qos
from sceneslam.types.errors import ConfigError, text_of

HOST = "127.0.0.1"  # only this machine can connect
_log = logging.getLogger(__name__)


class FoxgloveTransport:
    """Serves topics over Foxglove's WebSocket protocol.

    Panels can publish on topics that are subscribed here (JSON or CDR), and set `parameters`:
    name -> topic (String or Bool) on which the value is published.
    """

    def __init__(self, port: int, parameters: Mapping[str, str]) -> None:
        self._encoder = Encoder()
        self._publishers: dict[str, _Channel] = {}
        self._heard: dict[str, tuple[str, Heard]] = {}
        self._parameters = dict(parameters)
        self._lock = threading.RLock()
        self._context = foxglove.Context()
        try:
            self._server: Any = foxglove.start_server(
                name="sceneslam",
                host=HOST,
                port=port,
                context=self._context,
                capabilities=[Capability.ClientPublish, Capability.Parameters],
                supported_encodings=["json", "cdr"],
                server_listener=_Listener(self),
            )
        except Exception as error:
            raise ConfigError("port", port, f"a port that is free ({text_of(error)})") from error

    @property
    def url(self) -> str:
        """Return the address for Foxglove."""
        return f"ws://{HOST}:{self._server.port}"

    def publications(self) -> Sequence[Publication]:
        """Return no publishers: panels do not announce theirs."""
        return ()

    def subscribe(self, topic: str, msgtype: str, heard: Heard, qos: Qos = Qos.SENSOR) -> None:
        """Call `heard` for each message that a panel publishes on the topic."""
        self._heard[topic] = (msgtype, heard)

    def unsubscribe(self, topic: str) -> None:
        """End the subscription."""
        self._heard.pop(topic, None)

    def publisher(self, topic: str, msgtype: str, qos: Qos = Qos.RELIABLE) -> Publisher:
        """Return the topic's channel."""
        with self._lock:
            if topic not in self._publishers:
                schema = foxglove.Schema(
                    name=msgtype, encoding="ros2msg", data=self._encoder.definition(msgtype)
                )
                channel = foxglove.Channel(
                    topic, message_encoding="cdr", schema=schema, context=self._context
                )
                is_latched = qos in (Qos.LATCHED, Qos.HISTORY)
                self._publishers[topic] = _Channel(channel, is_latched=is_latched)
            return self._publishers[topic]

    def close(self) -> None:
        """Stop the server. May be called twice."""
        server, self._server = self._server, None
        if server is not None:
            for channel in self._publishers.values():
                channel.close()
            server.stop()

    def repeat(self, topic: str) -> None:
        """Repeat the last message of a latched topic for a late subscriber."""
        channel = self._publishers.get(topic)
        if channel is not None:
            channel.repeat()

    def hear(self, topic: str, encoding: str, data: bytes) -> None:
        """Deliver a panel's message to its subscriber."""
        msgtype, heard = self._heard.get(topic, ("", None))
        if heard is None:
            _log.warning("Foxglove published on %s, which has no subscriber", topic)
            return
        try:
            cdr = data if encoding == "cdr" else self._cdr(msgtype, json.loads(data)["data"])
        except (ValueError, KeyError, TypeError) as error:
            _log.warning("Foxglove published on %s: %s", topic, text_of(error))
            return
        heard(Arrival(topic=topic, cdr=cdr, arrived_ns=monotonic_ns()))

    def set_parameter(self, name: str, value: object) -> None:
        """Publish a parameter's value on its topic."""
        topic = self._parameters.get(name, "")
        if topic in self._heard:
            self.hear(topic, "json", json.dumps({"data": value}).encode())

    def parameters(self) -> list[Parameter]:
        """Return the parameters that panels may set."""
        empty = {"std_msgs/msg/Bool": False}
        return [
            Parameter(name, value=empty.get(self._heard[topic][0], ""))
            for name, topic in self._parameters.items()
            if topic in self._heard
        ]

    def _cdr(self, msgtype: str, value: object) -> bytes:
        """Return a String or a Bool; raises TypeError for another value."""
        if msgtype == "std_msgs/msg/Bool" and isinstance(value, bool):
            return b"\x00\x01\x00\x00" + bytes([value])
        if msgtype == "std_msgs/msg/String" and isinstance(value, str):
            return self._encoder.text(value)
        raise TypeError(f"{msgtype} cannot be made of {value!r}")


class _Channel:
    """Publishes on one channel."""

    def __init__(self, channel: Any, *, is_latched: bool) -> None:
        self._channel, self._is_latched = channel, is_latched
        self._last: bytes | None = None

    def publish(self, cdr: bytes) -> None:
        """Send a message to all subscribed panels."""
        if self._is_latched:
            self._last = cdr
        channel = self._channel
        if channel is not None:
            channel.log(cdr)

    def repeat(self) -> None:
        """Repeat the last message of a latched channel."""
        if self._last is not None and self._channel is not None:
            self._channel.log(self._last)

    def close(self) -> None:
        """Close the channel."""
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()


class _Listener:
    """Callbacks of the server's threads."""

    def __init__(self, transport: FoxgloveTransport) -> None:
        self._transport = transport
        self._channels: dict[tuple[int, int], tuple[str, str]] = {}  # -> topic, encoding
        self._values: dict[str, Parameter] = {}

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self._transport.repeat(channel.topic)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        pass

    def on_client_unadvertise(self, client: Any, client_channel_id: int) -> None:
        self._channels.pop((client.id, client_channel_id), None)

    def on_parameters_subscribe(self, param_names: list[str]) -> None:
        pass

    def on_parameters_unsubscribe(self, param_names: list[str]) -> None:
        pass

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        self._channels[client.id, channel.id] = (channel.topic, channel.encoding)

    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
        topic, encoding = self._channels.get((client.id, client_channel_id), ("", ""))
        if topic:
            self._transport.hear(topic, encoding, data)

    def on_get_parameters(
        self, client: Any, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        known = {one.name: one for one in self._transport.parameters()} | self._values
        return [one for name, one in known.items() if not param_names or name in param_names]

    def on_set_parameters(
        self, client: Any, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        for parameter in parameters:
            self._transport.set_parameter(parameter.name, parameter.get_value())
            self._values[parameter.name] = parameter
        return self.on_get_parameters(client, [])
