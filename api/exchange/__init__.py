"""Files of others, one module a format: `outward` writes them (`stimrig export`), `inward` reads them."""
