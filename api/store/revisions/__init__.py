"""Alembic scripts of the database; `stimrig.api.store.migrations` runs them."""
