"""The evaluation of timing and of attacks: measurements as records, and reports made from them."""
