"""The commands of `python -m palpate_studies`."""
