"""What moves while a test runs: the thread that sends, the thread that receives, and what stops them."""
