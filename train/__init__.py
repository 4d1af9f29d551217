"""Palpate's desktop: trains, judges and exports the model bundles that the appliance runs."""
