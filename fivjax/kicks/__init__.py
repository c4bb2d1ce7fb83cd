"""The boundary between sliding and squeal: critical kicks, smallest kicks, the stable manifold, grazing kicks."""
