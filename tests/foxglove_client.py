"""A client of Foxglove's WebSocket protocol (foxglove.sdk.v1), as far as the tests go."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct

TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
MESSAGE_DATA = 1  # the opcode in both directions


class FoxgloveClient:
    """Connects, follows topics, publishes, sets parameters; one thread."""

    def __init__(self, port: int, timeout_s: float = 10.0) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=timeout_s)
        key = base64.b64encode(os.urandom(16)).decode()
        request = (
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n"
            f"Connection: Upgrade\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        )
        self._socket.sendall(request.encode())
        self._file = self._socket.makefile("rb")
        assert b"101" in self._file.readline()
        while self._file.readline() not in (b"\r\n", b""):
            pass
        self.info = self.text("serverInfo")
        self.channels: dict[str, dict] = {}
        self._topics: dict[int, str] = {}
        self._published = 0

    def text(self, operation: str) -> dict:
        """Return the next JSON message of a kind; keeps announced channels on the way."""
        while True:
            kind, payload = self._frame()
            if kind == TEXT:
                message = json.loads(payload)
                if message["op"] == "advertise":
                    self.channels |= {one["topic"]: one for one in message["channels"]}
                if message["op"] == operation:
                    return message

    def subscribe(self, *topics: str) -> None:
        while not set(topics) <= self.channels.keys():
            self.text("advertise")
        new = dict(enumerate(topics, start=len(self._topics)))
        self._topics |= new
        wanted = [
            {"id": index, "channelId": self.channels[topic]["id"]} for index, topic in new.items()
        ]
        self.send({"op": "subscribe", "subscriptions": wanted})

    def message(self, topic: str) -> bytes:
        """Return the next message of a topic."""
        while True:
            kind, payload = self._frame()
            if kind == BINARY and payload[0] == MESSAGE_DATA:
                (number,) = struct.unpack_from("<I", payload, 1)
                if self._topics[number] == topic:
                    return payload[13:]  # after the time

    def publish(self, topic: str, schema: str, message: dict) -> None:
        """Publish JSON as Foxglove's Publish panel does."""
        self._published += 1
        channel = {"id": self._published, "topic": topic, "encoding": "json", "schemaName": schema}
        self.send({"op": "advertise", "channels": [channel]})
        data = struct.pack("<BI", MESSAGE_DATA, self._published) + json.dumps(message).encode()
        self._write(BINARY, data)

    def set_parameter(self, name: str, value: object) -> None:
        parameters = [{"name": name, "value": value}]
        self.send({"op": "setParameters", "parameters": parameters, "id": "set"})

    def parameters(self) -> dict:
        self.send({"op": "getParameters", "parameterNames": [], "id": "get"})
        found = self.text("parameterValues")["parameters"]
        return {one["name"]: one.get("value") for one in found}

    def send(self, message: dict) -> None:
        self._write(TEXT, json.dumps(message).encode())

    def close(self) -> None:
        self._file.close()
        self._socket.close()

    def _write(self, kind: int, payload: bytes) -> None:
        mask, size = os.urandom(4), len(payload)
        head = bytes([0x80 | kind])
        head += bytes([0x80 | size]) if size < 126 else struct.pack(">BH", 0x80 | 126, size)
        masked = bytes(byte ^ mask[index % 4] for index, byte in enumerate(payload))
        self._socket.sendall(head + mask + masked)

    def _frame(self) -> tuple[int, bytes]:
        first, second = self._file.read(2)
        size = second & 0x7F
        if size == 126:
            (size,) = struct.unpack(">H", self._file.read(2))
        elif size == 127:
            (size,) = struct.unpack(">Q", self._file.read(8))
        payload = self._file.read(size)
        if first & 0x0F == PING:
            self._write(PONG, payload)
        assert first & 0x0F != CLOSE, payload
        return first & 0x0F, payload
