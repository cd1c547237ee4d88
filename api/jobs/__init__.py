"""Long work in processes of its own: submit a job, follow its progress, cancel it, await its result."""
