"""Every method that names a material, behind one interface."""
