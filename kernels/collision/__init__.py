"""Collision refinement: vertices that are too close to something are moved away, and the cloth around them follows."""

from .body_contacts import BodyContacts, contacts
from .contact_set import ContactFrame, Contacts, ContactSource
from .solver import CollisionSolver, refine

__all__ = ["BodyContacts", "CollisionSolver", "ContactFrame", "ContactSource", "Contacts", "contacts", "refine"]
