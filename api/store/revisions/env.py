"""Run the revisions on the connection that `stimrig.api.store.migrations` passes, in its transaction."""

from alembic import context

context.configure(connection=context.config.attributes["connection"])
context.run_migrations()
