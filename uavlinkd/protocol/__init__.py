"""The uavlink protocol, sans-IO: bytes, ``now`` and entropy come in; datagrams, payloads and events go out.

Nothing in this package reaches a socket, a clock, a log or a random source, with one exception: ML-KEM's
encapsulation draws its randomness inside OpenSSL (``crypto.mlkem_encapsulate``).
``README.md`` beside this file is the specification.
"""
