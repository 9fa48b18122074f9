"""Bodies that are hardware, positioning systems and other middleware. One file per device."""
