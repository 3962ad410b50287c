"""Sockets and serial ports: the local MAVLink endpoints, and what reads and sends datagrams."""
