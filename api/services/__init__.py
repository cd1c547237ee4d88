"""What can be done with the service: one function for each action, typed input, one transaction, typed refusals."""
