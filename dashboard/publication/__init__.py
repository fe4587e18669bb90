"""A campaign as a static site: findings, tables, figures and every harmful flight, without a server."""
