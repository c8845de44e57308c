//! Messages whose item type is known only at run time.
//!
//! iceoryx2 ties a service to types that are known at compile time. For bindings to other languages, and for its own tunnel, it
//! has marker types, which carry name, size and alignment of the real types; this module uses them, too. The layout in shared
//! memory is the same as with the real types.

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
/// A received message.
pub(super) type Sample = sample::Sample<Ipc, [CustomPayloadMarker], CustomHeaderMarker>;
/// Memory for a message.
pub(super) type Loan = sample_mut::SampleMut<Ipc, [CustomPayloadMarker], CustomHeaderMarker>;

pub(super) type Untyped = Builder<[CustomPayloadMarker], CustomHeaderMarker, Ipc>;

/// Sets the message type of a service: a [`Header`], and items of this type. Fails if the name is too long.
pub(super) fn with_types(service: Untyped, item: &ItemType) -> Result<Untyped, String> {
    let detail = |variant, name: &str, size, align| {
        TypeDetail::__internal_new_from_parts(variant, name, size, align).map_err(|error| format!("{error:?}"))
    };
    let header = detail(TypeVariant::FixedSize, HEADER_TYPE_NAME, size_of::<Header>(), align_of::<Header>())?;
    let items = detail(TypeVariant::Dynamic, item.type_name(), item.size(), item.align())?;
    // SAFETY: these are size and alignment of the types that the functions below read and write, which are plain old data without
    // pointers; their names carry the versions of their layouts.
    Ok(unsafe { service.__internal_set_user_header_type_details(&header).__internal_set_payload_type_details(&items) })
}

/// The header of a received message.
pub(super) fn header_of(sample: &Sample) -> &Header {
    // SAFETY: the service has headers of this type, which is valid for all bit patterns.
    unsafe { &*std::ptr::from_ref(sample.user_header()).cast() }
}

/// The items of a received message, aligned as their type requires.
pub(super) fn items_of(sample: &Sample) -> &[u8] {
    let payload = sample.payload();
    // SAFETY: a marker is one byte, and there are as many markers as bytes of items.
    unsafe { std::slice::from_raw_parts(payload.as_ptr().cast(), payload.len()) }
}

/// Loans memory for a message of `length` items; it holds the content of an earlier message.
pub(super) fn loan(publisher: &Publisher, length: usize) -> Result<Loan, LoanError> {
    // SAFETY: the payload type of the service is a slice.
    let loaned = unsafe { publisher.loan_custom_payload(length) }?;
    // SAFETY: items are valid for all bit patterns, and the kernel has zeroed the bytes of a shared segment or an earlier message
    // has written them.
    Ok(unsafe { loaned.assume_init() })
}

/// The bytes of the items of a message to be sent.
pub(super) fn items_of_loan(loan: &mut Loan) -> &mut [u8] {
    let payload = loan.payload_mut();
    // SAFETY: a marker is one byte, and there are as many markers as bytes of items.
    unsafe { std::slice::from_raw_parts_mut(payload.as_mut_ptr().cast(), payload.len()) }
}

/// Writes the header of a message to be sent.
pub(super) fn set_header(loan: &mut Loan, header: &Header) {
    // SAFETY: the service has headers of this type.
    unsafe { *std::ptr::from_mut(loan.user_header_mut()).cast() = *header }
}
