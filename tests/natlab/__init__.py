"""A laboratory of address translators (NAT) in network namespaces: README.md beside this file."""
