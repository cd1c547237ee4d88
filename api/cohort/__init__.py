"""One verb over many recordings: chosen, spread over processes or machines, kept as a table, compared, drawn."""
