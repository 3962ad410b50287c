"""The uavlink protocol, sans-IO: bytes, ``now`` and entropy come in; datagrams, payloads and events go out.

Nothing in this package reaches a socket, a clock, a log or a source of chance.
``README.md`` beside this file is the specification.
"""
