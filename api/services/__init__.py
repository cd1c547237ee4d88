"""Actions of the service: one function for each, with typed input, one transaction and typed refusals."""
