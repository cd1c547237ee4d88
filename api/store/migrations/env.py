"""Run by Alembic: revisions go through the connection, and in the transaction, that `bring_up` has opened."""

from alembic import context

context.configure(connection=context.config.attributes["connection"])
with context.begin_transaction():
    context.run_migrations()
