"""Files of others: `outward` writes them (`stimrig export`), `inward` reads them (`stimrig import`); a file a format."""
