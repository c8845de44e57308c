//! Messages whose item type is told when the program runs.
//!
//! iceoryx2 ties a service to types that are known when a program is built. For the languages that it is bound to, and for its
//! own tunnel, it has markers in their place, with name, size and alignment of the real types beside them; so has this. What
//! is written that way and what is written with types of its own is the same in shared memory.

use super::services::Ipc;
use crate::item_type::ItemType;
use conicflow_messages::{HEADER_TYPE_NAME, Header};
use iceoryx2::port::LoanError;
use iceoryx2::port::{publisher, subscriber};
use iceoryx2::service::builder::publish_subscribe::Builder;
use iceoryx2::service::marker::{CustomHeaderMarker, CustomPayloadMarker};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use iceoryx2::service::static_config::message_type_details::{TypeDetail, TypeVariant};
use iceoryx2::{sample, sample_mut};

/// The service of a topic's messages.
pub(super) type Factory = PortFactory<Ipc, [CustomPayloadMarker], CustomHeaderMarker>;
pub(super) type Publisher = publisher::Publisher<Ipc, [CustomPayloadMarker], CustomHeaderMarker>;
pub(super) type Subscriber = subscriber::Subscriber<Ipc, [CustomPayloadMarker], CustomHeaderMarker>;
/// A message that came.
pub(super) type Sample = sample::Sample<Ipc, [CustomPayloadMarker], CustomHeaderMarker>;
/// Memory for a message.
pub(super) type Loan = sample_mut::SampleMut<Ipc, [CustomPayloadMarker], CustomHeaderMarker>;

pub(super) type Untyped = Builder<[CustomPayloadMarker], CustomHeaderMarker, Ipc>;

/// Tells a service what its messages are: a [`Header`], and items of this type. The reason why not, where the name is too long.
pub(super) fn with_types(service: Untyped, item: &ItemType) -> Result<Untyped, String> {
    let detail = |variant, name: &str, size, align| {
        TypeDetail::__internal_new_from_parts(variant, name, size, align).map_err(|error| format!("{error:?}"))
    };
    let header = detail(TypeVariant::FixedSize, HEADER_TYPE_NAME, size_of::<Header>(), align_of::<Header>())?;
    let items = detail(TypeVariant::Dynamic, item.type_name(), item.size(), item.align())?;
    // SAFETY: these are size and alignment of the types that the functions below read and write, which are plain old data
    // without pointers; their names carry the versions of their layouts.
    Ok(unsafe { service.__internal_set_user_header_type_details(&header).__internal_set_payload_type_details(&items) })
}

/// The header of a message that came.
pub(super) fn header_of(sample: &Sample) -> &Header {
    // SAFETY: the service has headers of this type, which is valid for all bit patterns.
    unsafe { &*std::ptr::from_ref(sample.user_header()).cast() }
}

/// The items of a message that came, aligned as their type says.
pub(super) fn items_of(sample: &Sample) -> &[u8] {
    let payload = sample.payload();
    // SAFETY: a marker is one byte, and there are as many as the items have.
    unsafe { std::slice::from_raw_parts(payload.as_ptr().cast(), payload.len()) }
}

/// Memory for a message of `length` items, with the content of an earlier one.
pub(super) fn loan(publisher: &Publisher, length: usize) -> Result<Loan, LoanError> {
    // SAFETY: the service's items are of a type of variable number.
    let loaned = unsafe { publisher.loan_custom_payload(length) }?;
    // SAFETY: items are valid for all bit patterns, and the bytes of a shared segment are those that the kernel zeroed or an
    // earlier message wrote.
    Ok(unsafe { loaned.assume_init() })
}

/// The bytes of the items of a message to be sent.
pub(super) fn items_of_loan(loan: &mut Loan) -> &mut [u8] {
    let payload = loan.payload_mut();
    // SAFETY: a marker is one byte, and there are as many as the items have.
    unsafe { std::slice::from_raw_parts_mut(payload.as_mut_ptr().cast(), payload.len()) }
}

/// Writes the header of a message to be sent.
pub(super) fn set_header(loan: &mut Loan, header: &Header) {
    // SAFETY: the service has headers of this type.
    unsafe { *std::ptr::from_mut(loan.user_header_mut()).cast() = *header }
}
