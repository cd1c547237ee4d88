"""Charts of models, diagnoses and recordings: for pages, reports and notebooks alike."""
