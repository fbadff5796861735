"""The wire format: can_dbc/modcube.dbc compiled once into fast encoders and decoders. Pure; no socket, no clock.

The firmware and the simulated nodes use it at both ends of every frame. cantools only reads the DBC; it encodes and decodes nothing here.
"""

from firmware_py.bus.codec.crc import crc8
from firmware_py.bus.codec.database import Codec, load_database
from firmware_py.bus.codec.message import NO_COUNTER, CodecError, Field, Frame, MessageCodec
from firmware_py.bus.codec.quaternion import pack_quaternion, unpack_quaternion
from firmware_py.bus.codec.receiver import Received, Receiver

__all__ = [
    "NO_COUNTER",
    "Codec",
    "CodecError",
    "Field",
    "Frame",
    "MessageCodec",
    "Received",
    "Receiver",
    "crc8",
    "load_database",
    "pack_quaternion",
    "unpack_quaternion",
]
