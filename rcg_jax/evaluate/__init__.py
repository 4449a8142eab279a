"""Success on rho_0 (appendix A.2)."""
