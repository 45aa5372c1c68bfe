"""Commands of studies and reproduction."""
