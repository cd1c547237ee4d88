"""Users, tokens, passwords and sessions."""
