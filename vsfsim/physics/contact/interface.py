"""The contact of a batch of touches as the solver sees it: with rigid bodies, or with a soft sensor."""

from vsfsim.physics.contact.pair.contact import PairContact
from vsfsim.physics.contact.rigid_contact import RigidContact

Contact = RigidContact | PairContact
"""Both have the methods that `RigidContact` describes."""
