"""What tests and demonstrates the link. The daemon never imports it."""
