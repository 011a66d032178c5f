"""Domains beside the rover's own: scans of other LiDARs, in other places, on other mounts, with true poses."""

from umf_ros.lab.simulation.domains.survey import DOMAINS, STRANGE_DOMAINS, Domain, DomainScan, survey

__all__ = ["DOMAINS", "STRANGE_DOMAINS", "Domain", "DomainScan", "survey"]
