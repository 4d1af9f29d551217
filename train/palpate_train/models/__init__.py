"""Every method that classifies sweeps, behind one interface."""
