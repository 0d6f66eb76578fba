"""Programs that use the package: the paper's transfers, a tutorial, the paper's reproduction."""
