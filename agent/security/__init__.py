"""Who somebody is and who may say what: keys, certificates, access control, signed orders."""
