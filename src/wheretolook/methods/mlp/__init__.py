"""The paper's network: an MLP over binned landmarks."""
