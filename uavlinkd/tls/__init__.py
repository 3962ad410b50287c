"""The relay by port 443: datagrams inside a WebSocket by TLS, for networks that let nothing else pass."""
