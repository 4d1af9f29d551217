"""Every way to name a material, behind one interface."""
