"""The technical file: tables of docs/safety held against the code and printed as one document (docs/safety)."""
