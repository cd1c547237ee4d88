"""Who may do what: tokens, passwords, sessions."""
