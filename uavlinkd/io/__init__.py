"""Sockets and serial ports: the local MAVLink endpoints, names, and what reads and sends datagrams."""
