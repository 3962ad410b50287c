"""The walk-throughs of ``configs/README.md``, run as they are written, on hosts made of namespaces."""
