"""The Wireshark dissector, run by tshark on captures of the core's own datagrams."""
