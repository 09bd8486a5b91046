"""Whether the policy ever does harm to what real systems put out."""
