"""A running test: the sending thread, the receiving thread, and what stops them."""
