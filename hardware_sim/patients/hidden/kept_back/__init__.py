"""Formulations drawn for seeds from 1000 only: nobody develops on them, so they tell how a diagnosis generalises."""
