"""The database: participants, tests, recordings, models, approvals, tokens and the audit trail."""

from stimrig.api.store.database import Store

__all__ = ["Store"]
